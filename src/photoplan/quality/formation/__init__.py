"""The formation of an image from a scene, step by step."""
