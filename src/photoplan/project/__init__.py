"""A project's description turned into scenes: cameras, terrain, and images with the steps that change their pixels."""
