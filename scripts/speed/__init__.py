"""Speed benchmarks of the package against the stock libraries. ``scripts/bench`` runs them."""
