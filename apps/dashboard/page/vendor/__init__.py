"""Files of others that the page needs, unchanged, each with its licence."""
