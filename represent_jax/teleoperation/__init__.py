"""A robot driven from a page in a browser, and what was driven recorded as demonstrations."""
