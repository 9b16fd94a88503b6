"""The demo: a page on which users request motions in the browser.

`flame-mdm demo` serves the page.
"""
