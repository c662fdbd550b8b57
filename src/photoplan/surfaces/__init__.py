"""Where the object is: a depth for every pixel of a target."""
