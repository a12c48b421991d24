"""The Minari root and the HDF5 file: where datasets lie, how they appear, how episodes are written and read.

Every file that the package makes is written here. Nothing here knows how episodes are made.
"""
