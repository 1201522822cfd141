"""Dense clouds: depth maps from water rays, fused."""
