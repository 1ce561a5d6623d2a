"""Samples from files: anybody's learning curve, recordings of real arms, and what they say."""
