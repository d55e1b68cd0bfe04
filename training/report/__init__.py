"""The report: one module and one template turn the table of any run into a page; what a kind of run shows is data."""
