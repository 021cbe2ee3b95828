"""A closed, colored surface guessed from one cut-out picture; needs no weights."""
