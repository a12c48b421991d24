"""The benchmark's results: few-shot imitation and offline baselines, computed, tabulated and reproduced.

A run computes cells and writes a line for each. Tables, figures and pages are made from the lines.
"""
