"""Fig. 3 of the paper, its experiments, and their parts of the report."""
