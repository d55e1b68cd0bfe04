"""Checks of arguments and their ranges, reading and writing of files, optional packages."""
