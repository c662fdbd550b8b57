"""From files to products: read, plan, execute, write."""
