"""The Minari root and the HDF5 file: where datasets are, how they appear, how episodes are written and read.

This package writes every file of a dataset. It knows nothing of how episodes are made.
"""
