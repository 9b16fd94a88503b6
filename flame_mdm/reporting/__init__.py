"""Tables, run reports, comparisons and data set pages.

Pages and tables are made from files, without loading a model.
"""
