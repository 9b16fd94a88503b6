"""Tables, run reports, comparisons and data set pages.

Pages and tables are generated from existing files, without loading a model.
"""
