"""The answer: what the errors and bounds say about how many samples are needed."""
