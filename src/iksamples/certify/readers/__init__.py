"""Networks that were trained elsewhere: what a file says, exactly, or why it is not read."""
