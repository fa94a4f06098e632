"""Light in a camera: point spread and vignetting, noise after EMVA 1288, and the images."""
