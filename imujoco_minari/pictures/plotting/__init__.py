"""Figures of datasets and of policies' transfer, by matplotlib."""
