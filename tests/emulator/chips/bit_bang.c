/* A firmware of a few lines that bangs I2C on several data lines at once, for test_i2c_wire.py:
   what it is linked against decides what its pins do. It looks at no acknowledge and at no clock. */

#include <stdint.h>

struct pins {
    void (*set_scl)(int level);
    void (*set_sda)(uint32_t levels);
    uint32_t (*sda)(void);
    void (*delay_ns)(uint32_t ns);
};

static const struct pins *pins;

static uint32_t clocked(int bit)
{
    uint32_t levels;

    pins->set_sda(bit ? 0xFFFFFFFFu : 0);
    pins->delay_ns(1000);
    pins->set_scl(1);
    levels = pins->sda();
    pins->delay_ns(1000);
    pins->set_scl(0);
    return levels;
}

static void start(void)
{
    pins->set_sda(0xFFFFFFFFu);
    pins->set_scl(1);
    pins->delay_ns(1000);
    pins->set_sda(0);
    pins->delay_ns(1000);
    pins->set_scl(0);
}

static void stop(void)
{
    pins->set_sda(0);
    pins->set_scl(1);
    pins->delay_ns(1000);
    pins->set_sda(0xFFFFFFFFu);
}

static void put(uint8_t byte)
{
    for (int bit = 7; bit >= 0; bit--)
        clocked(byte >> bit & 1);
    clocked(1);
}

/* Read n words from `at` of the chips at `address`, one on each of `lines` lines: words[line][n]. */
void read_words(const struct pins *given, uint8_t address, uint16_t at, int lines, int n,
                uint16_t *words)
{
    pins = given;
    start();
    put(address << 1);
    put(at >> 8);
    put(at & 0xFF);
    start();
    put(address << 1 | 1);
    for (int word = 0; word < n; word++)
        for (int bit = 0; bit < 18; bit++) {
            int last = word == n - 1 && bit == 17;
            uint32_t levels = clocked(bit % 9 != 8 || last);
            for (int line = 0; line < lines && bit % 9 != 8; line++)
                words[line * n + word] = words[line * n + word] << 1 | (levels >> line & 1);
        }
    stop();
}
