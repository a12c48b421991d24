"""The Minari root and the HDF5 file: paths of datasets, atomic commits, writing and reading of episodes.

This package writes every file of a dataset. It does not know how episodes are made.
"""
