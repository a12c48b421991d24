"""Ways in: the original's archive, and other datasets of the three robots.

Whatever comes from outside is bounded in size before it is read, checked against what it must be, and
published by the one path that all datasets take.
"""
