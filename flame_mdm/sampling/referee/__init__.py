"""The referee: reads the claims in a sentence, measures them on a motion and shows evidence."""
