"""A project's description becomes scenes: cameras, terrain, images with the steps that change their pixels."""
