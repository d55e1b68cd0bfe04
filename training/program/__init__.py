"""The program `grasp`: its command line (`cli`), the live page and films of the hand."""
