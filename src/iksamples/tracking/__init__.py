"""Tracking: the study, its grids and their seeds as MLflow runs, written by one process."""
