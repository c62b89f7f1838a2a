"""The embedded avatar of another look (data)."""
