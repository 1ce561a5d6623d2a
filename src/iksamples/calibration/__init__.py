"""A drawing fitted to what was measured on the arm, and how sure one may be of it."""
