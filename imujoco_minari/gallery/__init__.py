"""A static website of the variants."""
