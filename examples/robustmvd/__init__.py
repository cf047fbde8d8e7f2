"""geodiff-plugin as a model of the robustmvd benchmark."""
