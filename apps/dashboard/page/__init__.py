"""The files of the dashboard's page, as a browser takes them: no step builds them."""
