"""The arm: its file, forward kinematics, and inverse kinematics on one branch."""
