"""What a file is: recognised by its content, read by the reader that a run would use, and drawn without a run."""
