"""Correction of rendered pictures by the support views: held-out views, averages with the hull, residuals."""
