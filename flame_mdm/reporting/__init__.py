"""Tables, run reports, comparisons and data set pages.

They are made from files, without loading a model.
"""
