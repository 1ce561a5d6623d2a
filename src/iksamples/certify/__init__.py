"""Certified bounds: what is proved about a network's error over a whole box, not sampled."""
