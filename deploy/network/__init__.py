"""The deployed network: its description, its construction in Nengo, its responses, its exports."""
