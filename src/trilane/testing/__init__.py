"""Units that do nothing but take time. For tests, by name; no run uses them unless its configuration says so."""
