"""Files that every stage writes with: whole or not at all, locked, checked, as tables."""
