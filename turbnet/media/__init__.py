"""Files in and out: images, folders, video, TIFF, GIF; what is written appears whole or not at all."""
