"""GAPR-Net (arXiv 2606.13488) as plain PyTorch: every part of the paper and all its ablations behind one interface."""
