"""Exposures without images: drawn centres of stickers, as a detector would find them."""
