"""`photoplan restore`: filters measured, designed and applied."""
