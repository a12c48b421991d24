"""Pictures: rendered variants, figures of datasets, and the gallery of all variants."""
