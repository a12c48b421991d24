"""Figures of datasets and of the transfer of policies between variants. Requires matplotlib."""
