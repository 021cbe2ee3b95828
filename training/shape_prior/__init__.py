"""Training of the shape prior on creatures and things that a program makes up."""
