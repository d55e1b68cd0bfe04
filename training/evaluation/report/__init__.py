"""Reports: each kind of run describes its page as data; one template shows it."""
