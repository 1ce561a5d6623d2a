"""A network to take away from a finished study: ONNX, C, and what is proved of it."""
