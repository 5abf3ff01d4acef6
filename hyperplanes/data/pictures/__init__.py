"""What all readers share: images and masks from files, undistorted, of one size and with their poses."""
