"""Camera noise after EMVA 1288, and stereo images."""
