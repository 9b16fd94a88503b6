"""The referee: reads the claims in a sentence, checks them against a motion and shows evidence."""
