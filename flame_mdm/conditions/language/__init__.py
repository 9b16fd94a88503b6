"""Understanding of English prompts: actions, attributes and their order, the same for every model."""
