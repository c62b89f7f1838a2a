"""The data of the bundled avatar `hiker`."""
