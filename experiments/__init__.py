"""What was tried beside the product, kept to be compared with; nothing in dexzoo imports it."""
