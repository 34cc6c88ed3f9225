"""What is compared: meshes and closed-form surfaces, their readers, generators and sources."""
