"""``python -m imujoco_minari`` is the command line."""

from imujoco_minari.cli import main

if __name__ == "__main__":
    main()
