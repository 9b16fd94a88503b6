"""Understanding of English prompts, independent of a model: actions, attributes and order."""
