"""Pages made of saved trials; nothing is solved here."""
