"""Tables, run reports, comparisons and data set pages, from files alone: no model is loaded here."""
