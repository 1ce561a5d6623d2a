"""The arm: forward kinematics from a URDF, closed-form inverse kinematics, reachable workspace."""
