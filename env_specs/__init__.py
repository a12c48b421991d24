"""The robots, one TOML page for each. Data only; :mod:`imujoco_minari.variants.robots` reads them."""
