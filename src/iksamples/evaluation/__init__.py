"""Evaluation: how far the tool lands from where it was sent, through the forward kinematics."""
