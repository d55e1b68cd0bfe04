"""Reports: one module and one template turn the table of any run into a page; each kind of run
describes its content as data.
"""
