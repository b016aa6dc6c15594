"""What a run shows to a person: figures, tables, verdicts and a page with all of them."""
