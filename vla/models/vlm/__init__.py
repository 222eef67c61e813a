"""Vision-language-action models: a pretrained vision-language model with an action expert."""
