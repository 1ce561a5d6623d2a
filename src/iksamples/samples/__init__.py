"""Samples: which points are recorded, and their joint angles."""
