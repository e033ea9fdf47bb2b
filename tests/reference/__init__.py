"""Independent reference solutions and how to read them."""
