"""What a sensor can do, from its data sheet."""
