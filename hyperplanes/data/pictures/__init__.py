"""What every reader shares: pictures and masks from files, without their lens, of one size and with their poses."""
