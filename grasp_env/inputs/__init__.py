"""What users give: checks of arguments, their ranges, files, and optional packages."""
