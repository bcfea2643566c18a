"""Fuzzing: seeded inputs of every kind that stackgen reads, and what becomes of them."""
