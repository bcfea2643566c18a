"""Silhouettes as people make them, drawn by the program."""
