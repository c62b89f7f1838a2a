"""What a pipeline file says, before anything of it runs: `trilane check`."""
