"""Pictures: rendered variants, figures of datasets, and the gallery of all variants.

Each of the three has a package of its own: ``rendering``, ``plotting`` and ``gallery``. They read variants,
policies and datasets, and write pictures, videos and web pages.
"""
