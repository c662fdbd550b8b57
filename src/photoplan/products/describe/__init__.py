"""What a file is: images, terrain models, filters, cameras."""
