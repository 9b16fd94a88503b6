"""The referee: reads claims from a sentence, measures them on a motion, and shows evidence."""
