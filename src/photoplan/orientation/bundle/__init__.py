"""Bundle block adjustment."""
