"""The catalogue: one TOML file a robot. Data only; :mod:`imujoco_minari.variants.ids` reads it."""
