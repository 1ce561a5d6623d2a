"""What the paper alone claims: its equations, its Table 1, and whether they hold."""
