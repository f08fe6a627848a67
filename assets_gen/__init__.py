"""Makes the data that ships: python -m assets_gen WHAT."""
