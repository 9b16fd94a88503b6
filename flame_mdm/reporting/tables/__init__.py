"""Tables and figures from results: specs, building, and formats."""
