"""Many runs as one: what the paper's tables are made of, run as a graph and read from records."""
