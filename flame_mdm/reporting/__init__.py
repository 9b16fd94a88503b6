"""Tables, run reports, comparisons and data set pages, made from files alone. No model is loaded here."""
