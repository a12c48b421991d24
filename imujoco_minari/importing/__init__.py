"""Data from elsewhere: the original archive, and external datasets of the robots.

Every input is limited in size before it is read and checked before it is used. This package hands its
episodes to :mod:`imujoco_minari.publishing`, which publishes them as any other dataset.
"""
