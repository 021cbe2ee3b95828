"""Quality metrics: with ground truth (PSNR, SSIM, LPIPS, CLIP, FVD, Chamfer) and without (gates)."""
