"""The ground truth of the default avatar: the default body with clothes, hair and paint."""
