"""The demo: a web page on which users request motions.

`flame-mdm demo` serves the page.
"""
