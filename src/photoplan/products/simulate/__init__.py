"""Images of known truth, as a camera would take them."""
