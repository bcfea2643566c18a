"""Measurements of speed, memory and statistics, such as these, run from the repository root on a quiet machine:

    python -m benchmarks.cold_start --out docs/results/cold_start.json
    python -m benchmarks.training_speed --out docs/results/training_speed.json
    python -m benchmarks.simulator --out docs/results/simulator.json
    python -m benchmarks.brute_force --out docs/results/brute_force.json

Each prints what it found and on which machine. docs/README.md lists all of them. Nothing here passes or fails.
"""
