"""Linear models, operating points and trim."""
