"""A photo into pose, person mask and garment masks."""
