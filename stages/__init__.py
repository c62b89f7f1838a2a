"""What the three units do, one folder per unit."""
