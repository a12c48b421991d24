"""Pictures: rendered variants, figures of datasets, and the gallery of all variants.

Each has its own package: ``rendering``, ``plotting`` and ``gallery``. They read variants, policies and
datasets, and write pictures, videos and web pages.
"""
