"""Even colours between images: tables and trends that make them agree where they show the same ground."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "radiometry.equations": "Cells cells_of",
        "radiometry.balance": "Balanced balanced even_images",
        "radiometry.tone": "Tone toned",
        "radiometry.shown": "SeamLayer Shown features_of",
        "radiometry.seams": "SeamParts find_seams",
        "radiometry.illumination": "LightModel LitGround estimate_light",
    },
)
