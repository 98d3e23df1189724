"""The deployed network: its description, its building in Nengo, what it answers, its exports."""
