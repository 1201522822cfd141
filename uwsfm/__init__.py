"""uwsfm: refractive underwater Structure-from-Motion for rigs behind ports."""
