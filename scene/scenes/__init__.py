"""The scenes that come with Trilane, as TOML files (data)."""
