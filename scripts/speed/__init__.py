"""How fast the package is beside what people use today; run by ``scripts/bench``."""
