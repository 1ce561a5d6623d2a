"""Recording: a Rerun file per path, with the arm, the paths of every grid and how they came."""
