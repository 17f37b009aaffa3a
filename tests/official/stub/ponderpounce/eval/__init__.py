"""A stand-in for the official package: the signatures that public tests assert of it, and numbers for networks."""
